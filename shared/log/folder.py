"""What a run leaves in its folder, by name."""

from __future__ import annotations

CONFIG_NAME = "config.json"  # the resolved configuration, which every process of the run reads
LOG_NAME = "run.mcap"
PICTURE_NAME = "picture.png"
LOGS_NAME = "logs"  # a folder: what each process prints

"""Names of the files in a run's folder."""

from __future__ import annotations

CONFIG_NAME = "config.json"  # the resolved configuration, which every process of the run reads
LOG_NAME = "run.mcap"
PICTURE_NAME = "picture.png"
LOGS_NAME = "logs"  # a folder that holds what each process prints

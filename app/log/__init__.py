"""Logs of runs, for tools that do not know Saccade's messages."""

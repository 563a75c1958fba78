"""`python -m saccade`: the same as the command `saccade`."""

from saccade.app.cli.main import main

main()

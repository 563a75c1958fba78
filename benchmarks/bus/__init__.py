"""How long a camera image takes from one process to another: our bus beside others, in one run."""

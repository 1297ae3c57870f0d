"""The ``aenerf`` command, one file for each subcommand."""

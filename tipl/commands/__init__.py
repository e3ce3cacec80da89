"""The subcommands of ``tipl``; ``tipl.cli`` imports the one that is run."""

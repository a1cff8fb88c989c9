"""The text output of commands: one module per command."""

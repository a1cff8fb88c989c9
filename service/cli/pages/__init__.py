"""What commands print for people: one module a command, of what the command found."""

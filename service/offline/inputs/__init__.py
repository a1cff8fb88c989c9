"""From any file to a recording: what is wanted of it (`wanted`), how it is read (`read`), and what is asked."""

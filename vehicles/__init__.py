"""The vehicle files that ship with upright, read by `vehicles.file.load`."""

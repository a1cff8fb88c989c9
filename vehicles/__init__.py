"""The vehicle files that ship with upright, read by `service.vehicle_file.file.load`."""

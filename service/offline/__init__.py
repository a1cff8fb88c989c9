"""Work on finished recordings. inputs/ reads them, from any file; then a module for each command (identify, compare,
diagnose, design, multisine); next_experiment chooses what to record next; export and trail write."""

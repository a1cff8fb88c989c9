"""The asyncio shell: daemon, control loop, observer process, safety, sequence, MQTT and the command line."""

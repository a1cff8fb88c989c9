"""MQTT: topics say what is published, payloads make it, the client tells a broker, from a thread of its own; commands
and replies are the way back."""

"""MQTT: topics defines the messages, payloads builds them, client sends them to a broker, from a thread of its own;
commands and replies are the reverse direction."""

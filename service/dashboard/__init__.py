"""The dashboard: a static page, live over MQTT websockets, and beside it a small server of recordings and jobs."""

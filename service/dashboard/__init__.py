"""The dashboard: a static page with live data over MQTT websockets, and a small server for recordings and jobs."""

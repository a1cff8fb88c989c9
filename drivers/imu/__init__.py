"""The LPMS-IG1: how it packs readings into frames (layout), what an unknown one streams (format), the readings (imu),
and whether it repeats itself (repeats)."""

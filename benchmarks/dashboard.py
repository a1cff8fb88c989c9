"""Measure the cost of the dashboard: memory after hours, frames per second, delay, and its load on the control loop.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/dashboard.py [soak] [latency] [browsers]

All parts are real: Debian's mosquitto, the shipped page in Debian's Chromium, and the daemon with a virtual vehicle.

soak      four hours (HOURS) of telemetry, parameters, diagnoses and events, as fast as the page accepts them; then at
          the real rate, in each view: memory of the page's renderer (resident as it is, resident and unshared after a
          garbage collection, JavaScript heap) and frames per second
latency   from the time stamp of a sample to the browser frame after the one that drew it, at rest and in an experiment
          whose lease the page holds; the longest gap between the page's lease renewals
browsers  from the last frame of an IMU set to the first setpoint on the bus, with 0, 1 and 10 pages attached, and with
          10 pages attached to another broker; browsers and daemon run on a core each; ratios within each of several
          rounds (ROUNDS), with a 95 % interval
"""

from __future__ import annotations

import os
import sys

from dashboard_latency import latency
from dashboard_soak import HOURS, soak
from dashboard_watchers import ROUNDS, publish_story, watchers

if __name__ == "__main__":
    wanted = sys.argv[1:] or ["soak", "latency", "browsers"]
    if wanted[0] == "story":  # for the pages at the other broker
        publish_story(int(wanted[1]))
    if "soak" in wanted:
        soak(float(os.environ.get("HOURS", HOURS)))
    if "latency" in wanted:
        latency()
    if "browsers" in wanted:
        watchers(int(os.environ.get("ROUNDS", ROUNDS)))

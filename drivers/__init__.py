"""CAN frames to samples and back: the bus, CANopen, the CiA 402 drives, the IMU. Units become SI here, nowhere else.

Where asammdf is installed, python-can imports it to write log files, and with it pandas, pyarrow and sympy: a second
and a hundred megabytes that no bus needs. So python-can is imported here first, and does not find it; who exports MF4
does.
"""

import sys

if "can" not in sys.modules and "asammdf" not in sys.modules:
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # as the import system marks what is not to be found
    try:
        import can as can
    finally:
        del sys.modules["asammdf"]

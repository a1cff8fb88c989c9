"""CAN frames to samples and back: the bus, CANopen, the CiA 402 drives, the IMU. Units become SI here, nowhere else.

If asammdf is installed, python-can imports it to write log files, and with it pandas, pyarrow and sympy. That costs a
second and a hundred megabytes that no bus needs. So python-can is imported here first, with asammdf hidden from it; the
MF4 export still finds it.
"""

import sys

if "can" not in sys.modules and "asammdf" not in sys.modules:
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # marks a module as not to be found
    try:
        import can as can
    finally:
        del sys.modules["asammdf"]

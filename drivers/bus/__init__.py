"""A CAN bus of any kind as the event loop sees it (bus): opened by its address (address), read and written by SocketCAN
(socketcan) or by python-can (message_port), stamped by a clock that nobody sets (frame_clock), and locked for one
master (lock)."""

"""The vehicle file: sections are shared by all kinds of vehicle, file reads and checks a whole one."""

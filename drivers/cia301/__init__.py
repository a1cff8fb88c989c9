"""CANopen, whatever the node is: network management, emergencies, SDO client (CiA 301), EDS texts (CiA 306)."""

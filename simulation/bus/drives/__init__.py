"""What a drive of the virtual bus is told: a speed, a torque, a voltage, or nothing while it turns freely."""

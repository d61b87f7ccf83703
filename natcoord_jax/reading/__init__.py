"""What is read of a motion: energies, sensors, accelerations and reactions, errors, reports."""

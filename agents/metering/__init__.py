"""Light meters and their programs: from a frame to the EV that it asks for, to a state."""

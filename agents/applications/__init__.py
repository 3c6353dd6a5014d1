"""Other uses of the simulator: shallow depth of field and HDR from one raw."""

"""What may cause an error, one block of columns each: effects, unknown laws, the device, drift."""

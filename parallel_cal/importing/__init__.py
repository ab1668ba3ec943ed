"""Read what controllers store: samples, and models of their machines as configured."""

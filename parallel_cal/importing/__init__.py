"""What controllers store, as samples and as model files of their machines as configured."""

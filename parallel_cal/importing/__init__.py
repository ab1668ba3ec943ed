"""Files of controllers, as samples and as models of their machines as configured."""

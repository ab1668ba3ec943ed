"""The live page of a session: see where the model fails, add what is missing, watch the error."""

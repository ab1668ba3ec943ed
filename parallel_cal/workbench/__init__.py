"""The live page of a session: see where the model fails, add the missing effect."""

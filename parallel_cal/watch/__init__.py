"""Follow a calibrated robot through ordinary recordings, and say which part has changed."""

"""Printed boards, and the corners of a board in an image."""

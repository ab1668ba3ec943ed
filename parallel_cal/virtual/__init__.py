"""Robots, drives and devices to try on: independent of every other room."""

"""Torque queries and evaluation."""

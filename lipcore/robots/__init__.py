"""Robots as Pinocchio has them: those that are installed, random ones, URDFs, and simulated recordings."""

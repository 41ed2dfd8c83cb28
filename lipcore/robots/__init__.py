"""Robots as Pinocchio models: installed ones, URDFs, and simulated recordings."""

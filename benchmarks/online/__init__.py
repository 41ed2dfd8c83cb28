"""Benchmarks of online learning: throughput, changes of the robot, payloads, and durability."""

"""Latency of answers in process and over every transport, and of baselines."""

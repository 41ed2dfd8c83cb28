"""The report on a recording: sampling, faults, excitation, and what to record next."""

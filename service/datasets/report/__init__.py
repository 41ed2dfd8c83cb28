"""What is told of a recording: how it was sampled, what is wrong with it, what it can teach, what to record next."""

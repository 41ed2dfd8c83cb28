"""Playing a motion to a model in real time: `lipserve stream`."""

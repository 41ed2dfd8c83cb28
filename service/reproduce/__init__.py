"""The paper's experiment on simulated robots: `lipserve reproduce`."""

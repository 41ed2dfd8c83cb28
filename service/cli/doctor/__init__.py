"""`lipserve doctor`: what this machine permits, and the loop rate that it holds."""

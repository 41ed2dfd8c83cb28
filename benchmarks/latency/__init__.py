"""How long answers take: in process, over every transport, beside baselines."""

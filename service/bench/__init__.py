"""`lipserve bench`: how long answers take, by every way to ask, next to baselines of the same run; and learning."""

"""Settings of the whole suite."""

from hypothesis import settings

# derandomized: a failure on one machine is a failure on every machine
settings.register_profile("lipserve", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("lipserve")

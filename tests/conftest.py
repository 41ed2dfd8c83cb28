"""Settings of the whole suite."""

from hypothesis import settings

# derandomized: a failure on one machine is a failure on every machine
settings.register_profile("lipserve", derandomize=True, deadline=None, max_examples=20)
settings.register_profile("thorough", settings.get_profile("lipserve"), max_examples=100)  # of `make test-all`
settings.load_profile("lipserve")

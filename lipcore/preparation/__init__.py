"""From recordings as robots make them to samples: a recipe, a plan of what it does to a recording, and its steps."""

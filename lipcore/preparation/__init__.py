"""Preparation of raw recordings as samples: a recipe, its plan for one recording, and a record of the steps."""

"""The guide: the documentation as a site, so that a robot's network without a way out has it too."""

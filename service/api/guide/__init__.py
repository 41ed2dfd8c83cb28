"""The guide: the documentation as web pages, so that a robot's network without a way out has it too."""

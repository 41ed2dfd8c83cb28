"""The guide: the documentation as a site, also available in robot networks without internet access."""

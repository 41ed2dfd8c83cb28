"""Who may do what: API keys with scopes, and what protects a service that needs none."""

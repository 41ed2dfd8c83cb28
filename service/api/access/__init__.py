"""Access control: API keys with scopes, and the protection of a service without keys."""

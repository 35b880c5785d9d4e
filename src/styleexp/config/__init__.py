"""The configuration: its schema, and everything between typed words and a `schema.Config`."""

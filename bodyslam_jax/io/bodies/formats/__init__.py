"""Body formats: every `BodyFormat` in a module of this folder is read."""

"""File formats: one folder each, its reader beside its writer."""

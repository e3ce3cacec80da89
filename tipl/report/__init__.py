"""Results as tables, figures, sentences and pages."""

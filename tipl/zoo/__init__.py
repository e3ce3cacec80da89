"""Released models: what is known of them, their cards, and how they are published."""

"""One thing changed at a time: settings of a network, and what disturbs it."""

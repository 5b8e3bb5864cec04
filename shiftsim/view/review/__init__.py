"""Review of a store in the browser: a local server, its page, and what they exchange."""

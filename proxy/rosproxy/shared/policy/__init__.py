"""Policy: rules, layers of rules, and what they decide. All pure."""

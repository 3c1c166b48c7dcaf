"""What the controllers decide: pure functions over dataclasses."""

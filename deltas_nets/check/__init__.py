"""What is wrong with a capture: a verdict, its evidence, and the cure."""

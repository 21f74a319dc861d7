"""What is trained on, and how pictures are changed on the way."""

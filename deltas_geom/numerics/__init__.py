"""Small symmetric systems and how results are computed; nothing here knows of cameras."""

"""Reading finished datasets back as their clients do, and saying what is off."""

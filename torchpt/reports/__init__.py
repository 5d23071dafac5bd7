"""Studies: many renders, what they come to, and the page that shows it."""

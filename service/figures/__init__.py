"""One Plotly definition per figure; formats; no rendering of pages."""

"""The colours of objects in pictures, films and exports, in the order of their names."""

COLOURS = ("#d1495b", "#00798c", "#edae49", "#7b2d8b", "#3a7d44", "#2e4057", "#f26419", "#66a182")

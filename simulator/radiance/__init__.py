"""Light: drawn scenes, photographs and radiance maps, in linear sRGB and in a camera's colours."""

"""What a fitted material becomes for a game engine: compressed textures, weights, a manifest and shader source."""

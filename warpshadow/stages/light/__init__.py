"""Light on receivers: directions that sample it, visibility times cosine, and sums over the product."""

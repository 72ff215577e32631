"""From samples to an image: pixels, their derivative as surfaces move, and photographs behind them."""

"""Figures about captures and reconstructions: design sheets, pictures, comparisons."""

"""The model that is fitted: blocks driven by measured inputs, and the effects."""

"""Films: scenes of layers, each a function that draws frame k, as animations of Matplotlib's."""

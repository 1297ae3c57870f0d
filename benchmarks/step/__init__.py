"""The cost of training steps and of rendered pictures, beside nerfacto and beside an earlier commit."""

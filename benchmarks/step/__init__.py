"""The cost of training steps and of rendered pictures: by part, beside nerfacto, and beside an earlier commit."""

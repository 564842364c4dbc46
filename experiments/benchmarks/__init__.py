"""What runs cost: phases of an iteration, operations, memory, sweeps on paper, other people's code.

Measures the rooms above and changes nothing of them.
"""

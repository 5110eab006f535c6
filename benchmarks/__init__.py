"""How fast amibayes is, beside other programs and beside what the machine can do.

``python -m benchmarks`` measures everything in one run and prints ratios.
"""

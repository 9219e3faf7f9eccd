"""Certificates of gradients: which are right, how sure that is, and what it took.

``subject`` is what is examined, ``directions`` along what; ``spending`` draws batches where a verdict is open, and
``statistics`` tests them. Each check is a file of its own and a row of ``certify.CHECKS``; ``certificate`` is the
result.
"""

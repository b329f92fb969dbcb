"""The mathematics of Γ: segments, maps, trees, beliefs, adaptation, and the detector of changes.

Independent of any simulator. Evaluating an assessment needs numpy alone; torch, openTSNE
and dtaidistance are imported only by the functions that train.
"""

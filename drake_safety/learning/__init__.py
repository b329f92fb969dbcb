"""The mathematics of the safety assessment, from episodes to beliefs.

Independent of any simulator. Evaluating an assessment needs numpy alone; torch, openTSNE
and dtaidistance are imported only by the functions that train.
"""

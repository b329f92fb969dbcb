"""The mathematics of the safety assessment, from episodes to beliefs.

Nothing here knows a simulator. An assessment that is only evaluated needs numpy alone; torch,
openTSNE, dtaidistance and tslearn are imported by the functions that train.
"""

#!/bin/bash
# Sixteen workers of eight cores and this script's program on Slurm: sbatch examples/cluster/slurm.sh
# The scheduler and the program run on the first node, workers on all. The environment is on a shared file system.
#SBATCH --ntasks=16 --cpus-per-task=8 --mem-per-cpu=2G --time=01:00:00
file=$PWD/scheduler-$SLURM_JOB_ID.json
export WARP_CACHE_PATH=${WARP_CACHE_PATH:-$HOME/.cache/warp-$SLURM_CLUSTER_NAME}  # kernels, compiled once for all nodes
dask scheduler --scheduler-file "$file" --dashboard-address :0 &
until [ -s "$file" ]; do sleep 1; done
srun --overlap dask worker --scheduler-file "$file" --nthreads 1 --no-dashboard --local-directory "${TMPDIR:-/tmp}" &
python examples/cluster/local_cluster.py "$(python -c "import json; print(json.load(open('$file'))['address'])")"

"""What every room uses: files, checks, kernels, threads, rays and covariances, and how results show themselves."""

/* A driver of CUDA without a device: every call succeeds, kernels are stored, not run. Built and read by scripts/ptx.

   Memory of the device is memory of the host. Modules go to $PTX_OUT/N.ptx, launches, with their module and number of
   threads, to $PTX_OUT/launches. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SUCCEEDS(name) int name() { return 0; }
#define GIVES(name, type, value) int name(type *result) { *result = (type)(value); return 0; }

SUCCEEDS(cuInit) SUCCEEDS(cuCtxSetCurrent) SUCCEEDS(cuCtxSetLimit) SUCCEEDS(cuCtxPushCurrent_v2)
SUCCEEDS(cuDevicePrimaryCtxRelease_v2) SUCCEEDS(cuStreamSynchronize) SUCCEEDS(cuEventDestroy) SUCCEEDS(cuEventRecord)
SUCCEEDS(cuEventSynchronize) SUCCEEDS(cuMemAdvise) SUCCEEDS(cuMemPoolSetAttribute) SUCCEEDS(cuFuncSetAttribute)
SUCCEEDS(cuMemFree_v2) SUCCEEDS(cuMemFreeAsync) SUCCEEDS(cuPointerGetAttribute) SUCCEEDS(cuMemcpyDtoD_v2)
SUCCEEDS(cuMemsetD32_v2) SUCCEEDS(cuMemsetD8_v2) SUCCEEDS(cuExternalMemoryGetMappedBuffer)
SUCCEEDS(cuExternalMemoryGetMappedMipmappedArray) SUCCEEDS(cuImportExternalMemory) SUCCEEDS(cuImportExternalSemaphore)
SUCCEEDS(cuMipmappedArrayGetLevel) SUCCEEDS(cuSignalExternalSemaphoresAsync) SUCCEEDS(cuSurfObjectCreate)
SUCCEEDS(cuWaitExternalSemaphoresAsync)

static int handle;
GIVES(cuCtxCreate_v2, void *, &handle) GIVES(cuCtxGetCurrent, void *, &handle) GIVES(cuCtxPopCurrent_v2, void *, &handle)
GIVES(cuDevicePrimaryCtxRetain, void *, &handle) GIVES(cuStreamCreate, void *, &handle)
GIVES(cuEventCreate, void *, &handle) GIVES(cuDeviceGetDefaultMemPool, void *, &handle)
GIVES(cuEventElapsedTime, float, 0) GIVES(cuDeviceGetCount, int, 1) GIVES(cuDriverGetVersion, int, 12090)
GIVES(cuFuncGetAttribute, int, 64) GIVES(cuOccupancyMaxActiveBlocksPerMultiprocessor, int, 8)

int cuDeviceGet(int *device, int n) { *device = n; return 0; }
int cuDeviceGetName(char *name, int n) { snprintf(name, n, "none"); return 0; }
int cuGetErrorName(int code, const char **text) { *text = "error"; return 0; }
int cuGetErrorString(int code, const char **text) { *text = "error"; return 0; }
int cuMemGetInfo_v2(size_t *left, size_t *all) { *left = *all = (size_t)16 << 30; return 0; }

/* Those of compute capability 9.0 by their numbers in cuda.h: threads of a block, of a multiprocessor, and shared memory. */
int cuDeviceGetAttribute(int *value, int attribute) {
  switch (attribute) {
    case 75: *value = 9; break;
    case 76: *value = 0; break;
    case 1: *value = 1024; break;
    case 8: *value = 49152; break;
    case 10: *value = 32; break;
    case 16: *value = 132; break;
    case 39: *value = 2048; break;
    case 97: *value = 232448; break;
    case 106: *value = 32; break;
    default: *value = 1;
  }
  return 0;
}

static char *first = (char *)-1, *last;

static int allocate(void **place, size_t bytes) {
  char *found = *place = calloc(bytes + 4096, 1);
  if (!found) return 2;
  if (found < first) first = found;
  if (found + bytes > last) last = found + bytes;
  return 0;
}
int cuMemAlloc_v2(void **place, size_t bytes) { return allocate(place, bytes); }
int cuMemAllocAsync(void **place, size_t bytes) { return allocate(place, bytes); }
int cuMemAllocManaged(void **place, size_t bytes) { return allocate(place, bytes); }

/* What kernels would have written may be an address of nothing. */
static int known(const void *place) { return (char *)place >= first && (char *)place < last; }

int cuMemcpyDtoH_v2(void *to, const void *from, size_t bytes) {
  if (known(from)) memcpy(to, from, bytes); else memset(to, 0, bytes);
  return 0;
}
int cuMemcpyHtoD_v2(void *to, const void *from, size_t bytes) {
  if (known(to)) memcpy(to, from, bytes);
  return 0;
}
int cuMemcpyDtoHAsync_v2(void *to, const void *from, size_t bytes) { return cuMemcpyDtoH_v2(to, from, bytes); }
int cuMemcpyHtoDAsync_v2(void *to, const void *from, size_t bytes) { return cuMemcpyHtoD_v2(to, from, bytes); }

static FILE *open_in(const char *name, const char *mode) {
  char path[4096];
  snprintf(path, sizeof path, "%s/%s", getenv("PTX_OUT") ? getenv("PTX_OUT") : ".", name);
  return fopen(path, mode);
}

int cuModuleLoadDataEx(void **module, const char *ptx) {
  static int modules;
  char name[32];
  snprintf(name, sizeof name, "%d.ptx", ++modules);
  FILE *file = open_in(name, "w");
  if (file) { fputs(ptx, file); fclose(file); }
  *module = (void *)(intptr_t)modules;
  return 0;
}

int cuModuleGetFunction(void **function, void *module, const char *name) {
  char *text = malloc(strlen(name) + 24);
  sprintf(text, "%d %s", (int)(intptr_t)module, name);
  *function = text;
  return 0;
}

int cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx) {
  FILE *file = open_in("launches", "a");
  if (file) { fprintf(file, "%s %u\n", (char *)function, gx * bx); fclose(file); }
  return 0;
}

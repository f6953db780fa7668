/* Kills the process at the n-th system call that changes something below a directory; a write is torn in the middle.

   Loaded with LD_PRELOAD; kill_at(directory, n) arms it, and kill_calls() returns the calls counted since. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

static char place[PATH_MAX];
static long left, calls;

void kill_at(const char *directory, long n) {
    strncpy(place, directory, sizeof place - 1);
    left = n;
    calls = 0;
}

long kill_calls(void) { return calls; }

static int below(const char *path) { return place[0] && path && strncmp(path, place, strlen(place)) == 0; }

static int below_fd(int fd) {
    char name[64], path[PATH_MAX];
    if (!place[0]) return 0;
    snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(name, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return below(path);
}

/* Returns whether this is the call to die at. */
static int counted(int inside) {
    if (!inside) return 0;
    calls++;
    return left > 0 && --left == 0;
}

static void die(void) {
    raise(SIGKILL);
    for (;;) pause();
}

#define NEXT(name) static __typeof__(name) *next; if (!next) next = (__typeof__(next))dlsym(RTLD_NEXT, #name)

ssize_t write(int fd, const void *data, size_t n) {
    NEXT(write);
    if (counted(below_fd(fd))) { next(fd, data, n / 2); die(); }
    return next(fd, data, n);
}

ssize_t pwrite(int fd, const void *data, size_t n, off_t at) {
    NEXT(pwrite);
    if (counted(below_fd(fd))) { next(fd, data, n / 2, at); die(); }
    return next(fd, data, n, at);
}

ssize_t pwrite64(int fd, const void *data, size_t n, off64_t at) {
    NEXT(pwrite64);
    if (counted(below_fd(fd))) { next(fd, data, n / 2, at); die(); }
    return next(fd, data, n, at);
}

int fsync(int fd) {
    NEXT(fsync);
    if (counted(below_fd(fd))) die();
    return next(fd);
}

int ftruncate(int fd, off_t size) {
    NEXT(ftruncate);
    if (counted(below_fd(fd))) die();
    return next(fd, size);
}

int ftruncate64(int fd, off64_t size) {
    NEXT(ftruncate64);
    if (counted(below_fd(fd))) die();
    return next(fd, size);
}

int rename(const char *from, const char *to) {
    NEXT(rename);
    if (counted(below(to))) die();
    return next(from, to);
}

int unlink(const char *path) {
    NEXT(unlink);
    if (counted(below(path))) die();
    return next(path);
}

int rmdir(const char *path) {
    NEXT(rmdir);
    if (counted(below(path))) die();
    return next(path);
}

int mkdir(const char *path, mode_t mode) {
    NEXT(mkdir);
    if (counted(below(path))) die();
    return next(path, mode);
}

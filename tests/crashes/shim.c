/* Preloaded: stops the process, or fails, at the n-th change to files below a folder. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { COUNT, BEFORE, AFTER, EIO_ONCE, EIO_ON, FULL };

static char root[4096];
static size_t root_length;
static int mode, at;
static atomic_int calls;
static char noted[1 << 20]; /* a line per call: its name, and the path below the folder */
static size_t noted_length;

/* Exported: begin to count below a folder; with another mode than COUNT act at a call. */
void shim_arm(const char *folder, int new_mode, int new_at) {
    snprintf(root, sizeof root, "%s", folder);
    root_length = strlen(root);
    mode = new_mode;
    at = new_at;
    atomic_store(&calls, 0);
}

const char *shim_calls(void) { return noted; }

/* The rest of the path where it is below the folder, else null. */
static const char *below(int folder, const char *path) {
    static _Thread_local char full[8192];
    char base[4096] = "";
    if (!root_length || !path) return NULL;
    if (path[0] != '/') {
        if (folder == AT_FDCWD) {
            if (!getcwd(base, sizeof base)) return NULL;
        } else {
            char link[64];
            snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
            ssize_t n = readlink(link, base, sizeof base - 1);
            if (n < 0) return NULL;
            base[n] = 0;
        }
    }
    snprintf(full, sizeof full, "%s%s%s", base, path[0] == '/' ? "" : "/", path);
    if (strncmp(full, root, root_length)) return NULL;
    return full[root_length] == '/' || !full[root_length] ? full + root_length : NULL;
}

static const char *open_below(int file) {
    char link[64], path[4096];
    if (!root_length) return NULL;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return NULL;
    path[n] = 0;
    return below(AT_FDCWD, path);
}

static void die(void) {
    kill(getpid(), SIGKILL);
    for (;;) pause();
}

/* 0: go on; 1: go on and die; otherwise the error to report. */
static int next(const char *name, const char *path, int takes_space) {
    if (!path) return 0;
    noted_length += snprintf(noted + noted_length, sizeof noted - noted_length, "%s %s\n", name, path);
    if (noted_length >= sizeof noted) noted_length = sizeof noted - 1;
    int number = atomic_fetch_add(&calls, 1) + 1;
    if (mode == BEFORE && number == at) die();
    if (mode == AFTER && number == at) return 1;
    if (mode == EIO_ONCE && number == at) return EIO;
    if (mode == EIO_ON && number >= at) return EIO;
    if (mode == FULL && number >= at && takes_space) return ENOSPC;
    return 0;
}

#define REAL(name) static __typeof__(name) *real; \
    if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

#define WRAP(type, name, parameters, arguments, place, takes_space) \
    type name parameters { \
        REAL(name); \
        int order = next(#name, place, takes_space); \
        if (order > 1) { errno = order; return -1; } \
        type result = real arguments; \
        if (order == 1) die(); \
        return result; \
    }

/* A write of which only half arrives, before the process dies or the disk is full. */
#define WRAP_WRITE(name, parameters, arguments, file, half) \
    ssize_t name parameters { \
        REAL(name); \
        int order = next(#name, open_below(file), 1); \
        int is_first_full = order == ENOSPC && atomic_load(&calls) == at; \
        if (order == 1 || is_first_full) { half; } \
        else if (order > 1) { errno = order; return -1; } \
        ssize_t result = real arguments; \
        if (order == 1) die(); \
        return result; \
    }

#define HALVE if (size > 1) size /= 2
WRAP_WRITE(write, (int file, const void *data, size_t size), (file, data, size), file, HALVE)
WRAP_WRITE(pwrite, (int file, const void *data, size_t size, off_t where),
           (file, data, size, where), file, HALVE)
WRAP_WRITE(pwrite64, (int file, const void *data, size_t size, off64_t where),
           (file, data, size, where), file, HALVE)
WRAP_WRITE(writev, (int file, const struct iovec *parts, int size), (file, parts, size), file, HALVE)
WRAP_WRITE(pwritev, (int file, const struct iovec *parts, int size, off_t where),
           (file, parts, size, where), file, HALVE)
WRAP_WRITE(sendfile, (int file, int from, off_t *where, size_t size), (file, from, where, size),
           file, HALVE)
WRAP_WRITE(sendfile64, (int file, int from, off64_t *where, size_t size),
           (file, from, where, size), file, HALVE)
WRAP_WRITE(copy_file_range,
           (int from, off64_t *start, int file, off64_t *where, size_t size, unsigned flags),
           (from, start, file, where, size, flags), file, HALVE)

WRAP(int, fsync, (int file), (file), open_below(file), 1)
WRAP(int, fdatasync, (int file), (file), open_below(file), 1)
WRAP(int, ftruncate, (int file, off_t size), (file, size), open_below(file), 0)
WRAP(int, ftruncate64, (int file, off64_t size), (file, size), open_below(file), 0)
WRAP(int, truncate, (const char *path, off_t size), (path, size), below(AT_FDCWD, path), 0)
WRAP(int, truncate64, (const char *path, off64_t size), (path, size), below(AT_FDCWD, path), 0)
WRAP(int, fallocate, (int file, int how, off_t where, off_t size), (file, how, where, size),
     open_below(file), 1)
WRAP(int, unlink, (const char *path), (path), below(AT_FDCWD, path), 0)
WRAP(int, unlinkat, (int folder, const char *path, int flags), (folder, path, flags),
     below(folder, path), 0)
WRAP(int, rmdir, (const char *path), (path), below(AT_FDCWD, path), 0)
WRAP(int, remove, (const char *path), (path), below(AT_FDCWD, path), 0)
WRAP(int, mkdir, (const char *path, mode_t flags), (path, flags), below(AT_FDCWD, path), 1)
WRAP(int, mkdirat, (int folder, const char *path, mode_t flags), (folder, path, flags),
     below(folder, path), 1)
WRAP(int, link, (const char *old, const char *path), (old, path), below(AT_FDCWD, path), 1)
WRAP(int, linkat, (int from, const char *old, int folder, const char *path, int flags),
     (from, old, folder, path, flags), below(folder, path), 1)
WRAP(int, rename, (const char *old, const char *path), (old, path), below(AT_FDCWD, path), 1)
WRAP(int, renameat, (int from, const char *old, int folder, const char *path),
     (from, old, folder, path), below(folder, path), 1)

/* Opening counts where it makes a file. */
#define WRAP_OPEN(name, parameters, arguments, last, folder) \
    int name parameters { \
        REAL(name); \
        mode_t rights = 0; \
        if (flags & (O_CREAT | O_TMPFILE)) { \
            va_list more; \
            va_start(more, last); \
            rights = va_arg(more, mode_t); \
            va_end(more); \
        } \
        int order = flags & O_CREAT ? next(#name, below(folder, path), 1) : 0; \
        if (order > 1) { errno = order; return -1; } \
        int result = real arguments; \
        if (order == 1) die(); \
        return result; \
    }

WRAP_OPEN(open, (const char *path, int flags, ...), (path, flags, rights), flags, AT_FDCWD)
WRAP_OPEN(open64, (const char *path, int flags, ...), (path, flags, rights), flags, AT_FDCWD)
WRAP_OPEN(openat, (int folder, const char *path, int flags, ...), (folder, path, flags, rights),
          flags, folder)
WRAP_OPEN(openat64, (int folder, const char *path, int flags, ...), (folder, path, flags, rights),
          flags, folder)

/* Records every call that changes files below one folder, in one order for all processes; makes selected fsyncs fail.

   Preloaded into a service and its children (LD_PRELOAD). The environment names
     POWER_ROOT   the folder, a real path without links;
     POWER_LOG    the file that records are appended to, each by a single write; others may append theirs;
     POWER_STATE  a file of STATE bytes, all zero at first, which the processes share: a lock, and which fsyncs fail.
   A call and its record happen under the lock, so that the order of records is that in which the calls took effect.
   What a log could not tell later is a record of the kind UNKNOWN: memory that is mapped to be written to, holes, links.
   Nothing is flushed to the real disk: a log needs no disk that keeps its word. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <fnmatch.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { CREATE = 1, WRITE, RESIZE, RENAME, UNLINK, MKDIR, RMDIR, SYNC, FAILED, UNKNOWN }; /* recording.py: Kind */
#define EXPORT __attribute__((visibility("default")))
#define STATE 4096
#define REAL(name, result, ...) \
  static result (*real)(__VA_ARGS__); \
  if (!real) real = (result(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

struct record { uint32_t kind, size; uint64_t inode, at; uint32_t first, second; }; /* then two paths, then data */
struct state {
  pthread_mutex_t lock;
  uint64_t ready;
  char padding[512 - sizeof(pthread_mutex_t) - sizeof(uint64_t)];
  /* the fields below are set by tests: see recording.py */
  char match[128];   /* pattern of the paths whose fsync may fail */
  uint64_t skip;     /* number of those that succeed first */
  uint64_t failing;  /* number of those that fail then */
  uint64_t failed;   /* number of those that have failed */
};

static char root[PATH_MAX];
static size_t root_length;
static dev_t device;
static int record_file = -1;
static struct state *state;

static ssize_t real_write(int file, const void *data, size_t size) {
  REAL("write", ssize_t, int, const void *, size_t);
  return real(file, data, size);
}

static int real_open(const char *path, int flags, mode_t mode) {
  REAL("open64", int, const char *, int, ...);
  return real(path, flags, mode);
}

static void fail(const char *what) {
  char text[256];
  int length = snprintf(text, sizeof text, "watch.c: %s: %s\n", what, strerror(errno));
  if (real_write(2, text, length) < 0) _exit(71);
  _exit(70);
}

__attribute__((constructor)) static void begin(void) {
  const char *folder = getenv("POWER_ROOT"), *log = getenv("POWER_LOG"), *shared = getenv("POWER_STATE");
  struct stat about;
  if (!folder || !log || !shared) return;
  if (strlen(folder) >= sizeof root || stat(folder, &about)) fail("POWER_ROOT");
  strcpy(root, folder);
  device = about.st_dev;
  int records = real_open(log, O_WRONLY | O_APPEND | O_CLOEXEC, 0);
  int file = real_open(shared, O_RDWR | O_CLOEXEC, 0);
  if (records < 0 || file < 0) fail("POWER_LOG or POWER_STATE");
  record_file = fcntl(records, F_DUPFD_CLOEXEC, 700); /* a high number, because some programs choose file numbers */
  close(records);
  state = mmap(NULL, STATE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  if (state == MAP_FAILED || record_file < 0 || flock(file, LOCK_EX)) fail("POWER_STATE");
  if (!state->ready) {
    pthread_mutexattr_t how;
    pthread_mutexattr_init(&how);
    pthread_mutexattr_setpshared(&how, PTHREAD_PROCESS_SHARED);
    pthread_mutexattr_setrobust(&how, PTHREAD_MUTEX_ROBUST);
    pthread_mutex_init(&state->lock, &how);
    state->ready = 1;
  }
  flock(file, LOCK_UN);
  close(file);
  root_length = strlen(root); /* last, because it starts the recording */
}

static void lock(void) {
  int error = pthread_mutex_lock(&state->lock);
  if (error == EOWNERDEAD) error = pthread_mutex_consistent(&state->lock);
  if (error) { errno = error; fail("lock"); }
}

static void unlock(void) {
  int kept = errno;
  pthread_mutex_unlock(&state->lock);
  errno = kept;
}

static int below(const char *path) {
  return root_length && !strncmp(path, root, root_length) && (path[root_length] == '/' || !path[root_length]);
}

/* Get the path of an open file or folder; return whether it is watched. */
static int watched(int file, struct stat *about, char *path) {
  char link[32];
  int kept = errno, found = 0;
  if (!root_length) return 0;
  if (!fstat(file, about) && about->st_dev == device && (S_ISREG(about->st_mode) || S_ISDIR(about->st_mode))) {
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, PATH_MAX - 1);
    if (length > 0) {
      path[length] = 0;
      found = below(path);
    }
  }
  errno = kept;
  return found;
}

/* Make a path absolute; return whether it is watched. The reader of the log resolves `.` and `..`. */
static int meant(int folder, const char *path, char *full) {
  int kept = errno;
  ssize_t length = 0;
  if (!root_length || !path) return 0;
  if (path[0] == '/') {
    if (strlen(path) >= PATH_MAX) return 0;
    strcpy(full, path);
  } else {
    char link[32] = "/proc/self/cwd";
    if (folder != AT_FDCWD) snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    length = readlink(link, full, PATH_MAX - 1);
    errno = kept;
    if (length < 0 || length + 1 + strlen(path) >= PATH_MAX) return 0;
    full[length] = '/';
    strcpy(full + length + 1, path);
  }
  return below(full);
}

static void note(uint32_t kind, uint64_t inode, uint64_t at, const char *first, const char *second,
                 const struct iovec *data, int pieces, size_t size) {
  struct record record = {kind, size, inode, at, first ? strlen(first) : 0, second ? strlen(second) : 0};
  struct iovec parts[3 + pieces];
  int kept = errno, count = 0;
  size_t left = size;
  REAL("writev", ssize_t, int, const struct iovec *, int);
  parts[count++] = (struct iovec){&record, sizeof record};
  parts[count++] = (struct iovec){(char *)first, record.first};
  parts[count++] = (struct iovec){(char *)second, record.second};
  for (int i = 0; i < pieces && left; i++) { /* the call may have written only a part */
    size_t part = data[i].iov_len < left ? data[i].iov_len : left;
    parts[count++] = (struct iovec){data[i].iov_base, part};
    left -= part;
  }
  size_t total = sizeof record + record.first + record.second + size;
  if (real(record_file, parts, count) != (ssize_t)total) fail("record");
  errno = kept;
}

static void unknown(const char *call, const char *path) { note(UNKNOWN, 0, 0, path, call, NULL, 0, 0); }

/* Return the offset of the next write to a file. */
static off_t place(int file, const struct stat *about) {
  return fcntl(file, F_GETFL) & O_APPEND ? about->st_size : lseek(file, 0, SEEK_CUR);
}

/* Closing: a confined reader closes all files that it does not need, but its changes are recorded, too */

EXPORT int close(int file) {
  REAL("close", int, int);
  return file >= 0 && file == record_file ? 0 : real(file);
}

EXPORT int close_range(unsigned first, unsigned last, int flags) {
  unsigned kept = (unsigned)record_file;
  REAL("close_range", int, unsigned, unsigned, int);
  if (record_file < 0 || kept < first || kept > last) return real(first, last, flags);
  int below = kept > first ? real(first, kept - 1, flags) : 0, above = kept < last ? real(kept + 1, last, flags) : 0;
  return below ? below : above;
}

/* Opening */

static int opened(int folder, const char *path, int flags, mode_t mode) {
  char full[PATH_MAX];
  struct stat before, after;
  REAL("openat64", int, int, const char *, int, ...);
  if (!(flags & (O_CREAT | O_TRUNC | (O_TMPFILE & ~O_DIRECTORY))) || !meant(folder, path, full))
    return real(folder, path, flags, mode);
  lock();
  int was = !fstatat(folder, path, &before, 0), file = real(folder, path, flags, mode);
  if (file >= 0 && (flags & O_TMPFILE) == O_TMPFILE) { /* a power cut leaves nothing of it */
    if (fstat(file, &after)) fail("fstat");
    note(CREATE, after.st_ino, 0, NULL, NULL, NULL, 0, 0);
  }
  else if (file >= 0 && !fstat(file, &after) && S_ISREG(after.st_mode)) {
    if (!was) note(CREATE, after.st_ino, 0, full, NULL, NULL, 0, 0);
    else if (flags & O_TRUNC && before.st_size) note(RESIZE, after.st_ino, 0, full, NULL, NULL, 0, 0);
  }
  unlock();
  return file;
}

#define MODE(flags) \
  mode_t mode = 0; \
  if ((flags) & O_CREAT || ((flags) & O_TMPFILE) == O_TMPFILE) { \
    va_list rest; \
    va_start(rest, flags); \
    mode = va_arg(rest, mode_t); \
    va_end(rest); \
  }
EXPORT int open(const char *path, int flags, ...) { MODE(flags) return opened(AT_FDCWD, path, flags, mode); }
EXPORT int open64(const char *path, int flags, ...) { MODE(flags) return opened(AT_FDCWD, path, flags | O_LARGEFILE, mode); }
EXPORT int openat(int folder, const char *path, int flags, ...) { MODE(flags) return opened(folder, path, flags, mode); }
EXPORT int openat64(int folder, const char *path, int flags, ...) { MODE(flags) return opened(folder, path, flags | O_LARGEFILE, mode); }
EXPORT int __open_2(const char *path, int flags) { return opened(AT_FDCWD, path, flags, 0); } /* used by fortified code */
EXPORT int __open64_2(const char *path, int flags) { return opened(AT_FDCWD, path, flags | O_LARGEFILE, 0); }
EXPORT int __openat_2(int folder, const char *path, int flags) { return opened(folder, path, flags, 0); }
EXPORT int __openat64_2(int folder, const char *path, int flags) { return opened(folder, path, flags | O_LARGEFILE, 0); }
EXPORT int creat(const char *path, mode_t mode) { return opened(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
EXPORT int creat64(const char *path, mode_t mode) { return creat(path, mode); }

/* Writing */

EXPORT ssize_t write(int file, const void *data, size_t size) {
  char path[PATH_MAX];
  struct stat about;
  if (!watched(file, &about, path)) return real_write(file, data, size);
  lock();
  if (fstat(file, &about)) fail("fstat");
  off_t at = place(file, &about);
  ssize_t written = real_write(file, data, size);
  if (written > 0) note(WRITE, about.st_ino, at, path, NULL, &(struct iovec){(void *)data, written}, 1, written);
  unlock();
  return written;
}

EXPORT ssize_t pwrite64(int file, const void *data, size_t size, off64_t at) {
  char path[PATH_MAX];
  struct stat about;
  REAL("pwrite64", ssize_t, int, const void *, size_t, off64_t);
  if (!watched(file, &about, path)) return real(file, data, size, at);
  lock();
  ssize_t written = real(file, data, size, at);
  if (written > 0) note(WRITE, about.st_ino, at, path, NULL, &(struct iovec){(void *)data, written}, 1, written);
  unlock();
  return written;
}
EXPORT ssize_t pwrite(int file, const void *data, size_t size, off_t at) { return pwrite64(file, data, size, at); }

EXPORT ssize_t writev(int file, const struct iovec *parts, int count) {
  char path[PATH_MAX];
  struct stat about;
  REAL("writev", ssize_t, int, const struct iovec *, int);
  if (!watched(file, &about, path)) return real(file, parts, count);
  lock();
  if (fstat(file, &about)) fail("fstat");
  off_t at = place(file, &about);
  ssize_t written = real(file, parts, count);
  if (written > 0) note(WRITE, about.st_ino, at, path, NULL, parts, count, written);
  unlock();
  return written;
}

EXPORT ssize_t pwritev64v2(int file, const struct iovec *parts, int count, off64_t at, int flags) {
  char path[PATH_MAX];
  struct stat about;
  REAL("pwritev64v2", ssize_t, int, const struct iovec *, int, off64_t, int);
  if (!watched(file, &about, path)) return real(file, parts, count, at, flags);
  lock();
  if (at < 0 || flags) unknown("pwritev2", path);
  ssize_t written = real(file, parts, count, at, flags);
  if (written > 0) note(WRITE, about.st_ino, at, path, NULL, parts, count, written);
  unlock();
  return written;
}
EXPORT ssize_t pwritev2(int file, const struct iovec *parts, int count, off_t at, int flags) { return pwritev64v2(file, parts, count, at, flags); }
EXPORT ssize_t pwritev64(int file, const struct iovec *parts, int count, off64_t at) { return pwritev64v2(file, parts, count, at, 0); }
EXPORT ssize_t pwritev(int file, const struct iovec *parts, int count, off_t at) { return pwritev64v2(file, parts, count, at, 0); }

/* Record what the kernel copies, by reading the source again. */
static void copied(int from, off64_t first, int file, ssize_t size) {
  char path[PATH_MAX];
  struct stat about;
  if (size <= 0 || !watched(file, &about, path)) return;
  char *data = malloc(size);
  if (!data || pread64(from, data, size, first) != size) fail("copy");
  off_t at = lseek(file, 0, SEEK_CUR) - size;
  note(WRITE, about.st_ino, at, path, NULL, &(struct iovec){data, size}, 1, size);
  free(data);
}

EXPORT ssize_t sendfile64(int file, int from, off64_t *offset, size_t size) {
  char path[PATH_MAX];
  struct stat about;
  REAL("sendfile64", ssize_t, int, int, off64_t *, size_t);
  if (!watched(file, &about, path)) return real(file, from, offset, size);
  lock();
  off64_t first = offset ? *offset : lseek(from, 0, SEEK_CUR);
  ssize_t sent = real(file, from, offset, size);
  copied(from, first, file, sent);
  unlock();
  return sent;
}
EXPORT ssize_t sendfile(int file, int from, off_t *offset, size_t size) { return sendfile64(file, from, offset, size); }

EXPORT ssize_t copy_file_range(int from, off64_t *first, int file, off64_t *at, size_t size, unsigned flags) {
  char path[PATH_MAX];
  struct stat about;
  REAL("copy_file_range", ssize_t, int, off64_t *, int, off64_t *, size_t, unsigned);
  if (!watched(file, &about, path)) return real(from, first, file, at, size, flags);
  lock();
  if (at) unknown("copy_file_range", path);
  off64_t begun = first ? *first : lseek(from, 0, SEEK_CUR);
  ssize_t sent = real(from, first, file, at, size, flags);
  if (!at) copied(from, begun, file, sent);
  unlock();
  return sent;
}

EXPORT int ftruncate64(int file, off64_t size) {
  char path[PATH_MAX];
  struct stat about;
  REAL("ftruncate64", int, int, off64_t);
  if (!watched(file, &about, path)) return real(file, size);
  lock();
  int result = real(file, size);
  if (!result) note(RESIZE, about.st_ino, size, path, NULL, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int ftruncate(int file, off_t size) { return ftruncate64(file, size); }

EXPORT int truncate64(const char *path, off64_t size) {
  char full[PATH_MAX];
  struct stat about;
  REAL("truncate64", int, const char *, off64_t);
  if (!meant(AT_FDCWD, path, full)) return real(path, size);
  lock();
  int result = real(path, size);
  if (!result && !stat(path, &about)) note(RESIZE, about.st_ino, size, full, NULL, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int truncate(const char *path, off_t size) { return truncate64(path, size); }

EXPORT int fallocate64(int file, int mode, off64_t at, off64_t size) {
  char path[PATH_MAX];
  struct stat about;
  REAL("fallocate64", int, int, int, off64_t, off64_t);
  if (!watched(file, &about, path)) return real(file, mode, at, size);
  lock();
  int result = real(file, mode, at, size);
  if (!result && mode) unknown("fallocate", path);
  else if (!result && !fstat(file, &about)) note(RESIZE, about.st_ino, about.st_size, path, NULL, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int fallocate(int file, int mode, off_t at, off_t size) { return fallocate64(file, mode, at, size); }
EXPORT int posix_fallocate64(int file, off64_t at, off64_t size) { return fallocate64(file, 0, at, size) ? errno : 0; }
EXPORT int posix_fallocate(int file, off_t at, off_t size) { return posix_fallocate64(file, at, size); }

EXPORT void *mmap64(void *address, size_t size, int protection, int flags, int file, off64_t at) {
  char path[PATH_MAX];
  struct stat about;
  REAL("mmap64", void *, void *, size_t, int, int, int, off64_t);
  int shared = (flags & MAP_TYPE) == MAP_SHARED || (flags & MAP_TYPE) == MAP_SHARED_VALIDATE;
  if (file >= 0 && shared && protection & PROT_WRITE && watched(file, &about, path)) {
    size_t length = strlen(path);
    if (length < 4 || strcmp(path + length - 4, "-shm")) { /* SQLite recreates it after a power cut */
      lock();
      unknown("mmap", path);
      unlock();
    }
  }
  return real(address, size, protection, flags, file, at);
}
EXPORT void *mmap(void *address, size_t size, int protection, int flags, int file, off_t at) { return mmap64(address, size, protection, flags, file, at); }

/* Names */

EXPORT int renameat2(int from, const char *old, int to, const char *new, unsigned flags) {
  char first[PATH_MAX], second[PATH_MAX];
  REAL("renameat2", int, int, const char *, int, const char *, unsigned);
  int leaves = meant(from, old, first), comes = meant(to, new, second);
  if (!leaves && !comes) return real(from, old, to, new, flags);
  lock();
  int result = real(from, old, to, new, flags);
  if (!result && (!leaves || !comes || flags & ~RENAME_NOREPLACE)) unknown("rename", leaves ? first : second);
  else if (!result) note(RENAME, 0, 0, first, second, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int renameat(int from, const char *old, int to, const char *new) { return renameat2(from, old, to, new, 0); }
EXPORT int rename(const char *old, const char *new) { return renameat2(AT_FDCWD, old, AT_FDCWD, new, 0); }

EXPORT int linkat(int from, const char *old, int to, const char *new, int flags) {
  char full[PATH_MAX];
  REAL("linkat", int, int, const char *, int, const char *, int);
  if (meant(to, new, full)) {
    lock();
    unknown("link", full);
    unlock();
  }
  return real(from, old, to, new, flags);
}
EXPORT int link(const char *old, const char *new) { return linkat(AT_FDCWD, old, AT_FDCWD, new, 0); }

EXPORT int symlinkat(const char *old, int to, const char *new) {
  char full[PATH_MAX];
  REAL("symlinkat", int, const char *, int, const char *);
  if (meant(to, new, full)) {
    lock();
    unknown("symlink", full);
    unlock();
  }
  return real(old, to, new);
}
EXPORT int symlink(const char *old, const char *new) { return symlinkat(old, AT_FDCWD, new); }

EXPORT int unlinkat(int folder, const char *path, int flags) {
  char full[PATH_MAX];
  REAL("unlinkat", int, int, const char *, int);
  if (!meant(folder, path, full)) return real(folder, path, flags);
  lock();
  int result = real(folder, path, flags);
  if (!result) note(flags & AT_REMOVEDIR ? RMDIR : UNLINK, 0, 0, full, NULL, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int unlink(const char *path) { return unlinkat(AT_FDCWD, path, 0); }
EXPORT int rmdir(const char *path) { return unlinkat(AT_FDCWD, path, AT_REMOVEDIR); }
EXPORT int remove(const char *path) {
  struct stat about;
  return unlinkat(AT_FDCWD, path, !lstat(path, &about) && S_ISDIR(about.st_mode) ? AT_REMOVEDIR : 0);
}

EXPORT int mkdirat(int folder, const char *path, mode_t mode) {
  char full[PATH_MAX];
  REAL("mkdirat", int, int, const char *, mode_t);
  if (!meant(folder, path, full)) return real(folder, path, mode);
  lock();
  int result = real(folder, path, mode);
  if (!result) note(MKDIR, 0, 0, full, NULL, NULL, 0, 0);
  unlock();
  return result;
}
EXPORT int mkdir(const char *path, mode_t mode) { return mkdirat(AT_FDCWD, path, mode); }

/* Syncing */

EXPORT int fsync(int file) {
  char path[PATH_MAX];
  struct stat about;
  REAL("fsync", int, int);
  if (!watched(file, &about, path)) return real(file);
  lock();
  int result = 0;
  if (state->failing && !fnmatch(state->match, path, 0)) {
    if (state->skip) state->skip--;
    else {
      state->failing--;
      state->failed++;
      result = -1;
    }
  }
  note(result ? FAILED : SYNC, S_ISDIR(about.st_mode) ? 0 : about.st_ino, 0, path, NULL, NULL, 0, 0);
  unlock();
  if (result) errno = EIO;
  return result;
}
EXPORT int fdatasync(int file) { return fsync(file); }

EXPORT int sync_file_range(int file, off64_t at, off64_t size, unsigned flags) { return 0; } /* guarantees nothing */

/* C streams, which have their own write calls: NumPy stores arrays with them. */

static ssize_t stream_read(void *file, char *data, size_t size) { return read((intptr_t)file, data, size); }
static ssize_t stream_write(void *file, const char *data, size_t size) {
  ssize_t written = write((intptr_t)file, data, size);
  return written < 0 ? 0 : written;
}
static int stream_seek(void *file, off64_t *at, int whence) {
  *at = lseek64((intptr_t)file, *at, whence);
  return *at < 0 ? -1 : 0;
}
static int stream_close(void *file) { return close((intptr_t)file); }

EXPORT FILE *fdopen(int file, const char *mode) {
  char path[PATH_MAX];
  struct stat about;
  REAL("fdopen", FILE *, int, const char *);
  if (!watched(file, &about, path) || (mode[0] == 'r' && !strchr(mode, '+'))) return real(file, mode);
  cookie_io_functions_t calls = {stream_read, stream_write, stream_seek, stream_close};
  return fopencookie((void *)(intptr_t)file, mode, calls);
}

EXPORT FILE *fopen64(const char *path, const char *mode) {
  char full[PATH_MAX];
  REAL("fopen64", FILE *, const char *, const char *);
  if (meant(AT_FDCWD, path, full) && (mode[0] != 'r' || strchr(mode, '+'))) {
    lock();
    unknown("fopen", full);
    unlock();
  }
  return real(path, mode);
}
EXPORT FILE *fopen(const char *path, const char *mode) { return fopen64(path, mode); }

// Instruction sets: the library is built for several, and the best one is loaded.

extern "C" {

// The best of the instruction sets in kernels/library.py that this processor has, by its number there.
int best_instruction_set() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
    return avx2 ? (avx512 ? 2 : 1) : 0;
#else
    return 0;
#endif
}

// SHA-256 of the sources of this library.
const char* kernel_sources() { return EDDIES_SOURCES; }

}  // extern "C"

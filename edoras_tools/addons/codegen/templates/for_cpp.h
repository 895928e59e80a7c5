#ifdef __cplusplus
extern "C" {
#endif

$body
#ifdef __cplusplus
}
#endif

#ifndef $symbol
#define $symbol

$body
#endif

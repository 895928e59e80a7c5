
/** $about */
typedef struct
{
    CFE_MSG_${kind}Header_t $head;
    uint8_t data[(2U * EDORAS_ENVELOPE_WORD) + ${type}__MAX_CDR];
} ${struct}_t;

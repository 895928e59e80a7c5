/** $ros_name */
typedef struct {
$members} $name;

$constants/** Bytes of the longest CDR of $ros_name, encapsulation included. */
#define ${name}__MAX_CDR ${most_bytes}U

$declared

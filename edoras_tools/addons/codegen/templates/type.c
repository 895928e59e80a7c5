EDORAS_FUNCTIONS($name)

static const MemberInfo_t ${name}__members[] = {
$rows};

${make_pool}static const TypeInfo_t ${name}__type = {
    "$package",
    "$short_name",
    ${members}U,
    sizeof($name),
    EDORAS_BUFFER_SIZE($name),
    ${name}__members,
    ${name}__init_any,
    ${name}__encode_any,
    ${name}__decode_any,
    $pool,
};

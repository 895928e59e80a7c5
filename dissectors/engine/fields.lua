-- What Wireshark shows: the protocols, a field for every slot of every layout, and the expert information.

-- Looked up once: tree:add() and the like search for the method in every call.
local add, add_le, cut = TreeItem.add, TreeItem.add_le, Tvb.range
local set_text, set_generated, add_expert = TreeItem.set_text, TreeItem.set_generated, TreeItem.add_proto_expert_info

local TITLES = {
	ccsds_sp = "CCSDS Space Packet", cfe = "core Flight System", ros2cdr = "ROS 2 message (CDR)",
}
for _, link in ipairs(D.links) do
	if #link.headers > 0 then TITLES[link.label] = link.title end
end
local P = {edoras = EDORAS}
local members = {edoras = {}}
for name, title in pairs(TITLES) do
	local made, proto = pcall(Proto, name, title)
	if not made then proto = Proto("edoras_" .. name, title) end  -- Wireshark knows a protocol of that name
	P[name], members[name] = proto, {}
end
local by_name = {}  -- abbreviation to record

-- Make a field, or find the one of that name. A record's `on` tells whether anybody asks for it, where there
-- is no tree for people.
local function new_field(protocol, abbreviation, kind, ...)
	local record = by_name[abbreviation]
	if not record then
		local made = ProtoField[kind](abbreviation, ...)
		record = {field = made, protocol = protocol, on = false}
		by_name[abbreviation] = record
		table.insert(members[protocol], made)
		table.insert(members, record)
	end
	return record
end

-- Tell what a special value of a field means.
local function mark(item, value, names)
	if names[value] then item:append_text(" (" .. names[value] .. ")") end
end

-- Make a function that adds some slots of a layout, without a loop: (node, tvb, offset, the datagram's bytes).
local function adder(layout, slots)
	local text = {"local add, put, turn, cut, text, mark, fields, names = ...", "", "return function(node, tvb, at, s)", "local range"}
	local fields, names, before = {}, {}, {}
	for index, slot in ipairs(slots) do
		fields[index], names[index] = slot.record.field, slot.names
		text[2] = text[2] .. format("\nlocal field%d = fields[%d]", index, index)
		if slot.start ~= before.start or slot.size ~= before.size then
			text[#text + 1] = format("range = cut(tvb, at + %d, %d)", slot.start, slot.size)
		end
		if slot.kind == "string" then
			text[#text + 1] = format(
				"add(node, field%d, range, text(s, at + %d, at + %d))", index, slot.start + 1, slot.start + slot.size
			)
		elseif slot.special then
			text[#text + 1] = format(
				"mark(%s(node, field%d, range), range:bitfield(%d, %d), names[%d])", slot.turned and "turn" or "put",
				index, slot.special[1], slot.special[2], index
			)
		else
			text[#text + 1] = format("%s(node, field%d, range)", slot.turned and "turn" or "put", index)
		end
		before = slot
	end
	text[#text + 1] = "end"
	local function readable(...) return utf8_text(D.text(...)) end
	local put, turn = add, add_le
	if layout.little then put, turn = turn, put end
	return load(table.concat(text, "\n"))(add, put, turn, cut, readable, mark, fields, names)
end

for _, layout in pairs(D.layouts) do
	for _, slot in ipairs(layout.fields) do
		if not slot.kind:find("int") then
			slot.record = new_field(layout.protocol, slot.abbreviation, slot.kind, slot.name, nil, slot.doc)
		else
			slot.record = new_field(
				layout.protocol, slot.abbreviation, slot.kind, slot.name, slot.hex and base.HEX or base.DEC,
				not slot.special and slot.names or nil, slot.mask, slot.doc
			)
		end
	end
	layout.proto, layout.add_all = P[layout.protocol], adder(layout, layout.fields)
	if layout.title == TITLES[layout.protocol] then layout.title = nil end  -- Wireshark says so by itself
end

local F = {
	buffer_length = new_field("edoras", "edoras.buffer_length", "uint64", "buffer_length", base.DEC),
	buffer_capacity = new_field("edoras", "edoras.buffer_capacity", "uint64", "buffer_capacity", base.DEC),
	spare = new_field("edoras", "edoras.spare", "uint64", "spare", base.HEX),
	crc = new_field("edoras", "edoras.crc", "uint32", "crc", base.HEX),
	link = new_field("edoras", "edoras.link", "string", "Link"),
	msg_id = new_field("edoras", "edoras.msg_id", "uint16", "MsgId", base.HEX),
	name = new_field("edoras", "edoras.name", "string", "Name"),
	topic = new_field("edoras", "edoras.topic", "string", "Topic"),
	type = new_field("edoras", "edoras.type", "string", "Type"),
	command = new_field("edoras", "edoras.command", "string", "Command"),
	mission_time = new_field("edoras", "edoras.mission_time", "double", "Mission time, s since its epoch"),
	mission_utc = new_field("edoras", "edoras.mission_utc", "string", "Mission time, UTC"),
	finding = new_field("edoras", "edoras.finding", "string", "Finding"),
	text = new_field("edoras", "edoras.message", "string", "Message"),
	stop = new_field("edoras", "edoras.stop", "string", "Decoded no further"),
	padding = new_field("edoras", "edoras.padding", "bytes", "Padding"),
	gap = new_field("edoras", "edoras.gap", "uint16", "Packets missing before this one", base.DEC),
	duplicate = new_field("edoras", "edoras.duplicate", "bool", "Same sequence count and bytes as an earlier packet"),
	reordered = new_field("edoras", "edoras.reordered", "bool", "Came after a packet with a higher sequence count"),
	body = new_field("ros2cdr", "ros2cdr.body", "bytes", "Body"),
}

local SEVERITY = {note = expert.severity.NOTE, warning = expert.severity.WARN, error = expert.severity.ERROR}
local RANK = {note = 1, warning = 2, error = 3}
local MARK = {warning = "! ", error = "\226\156\151 "}
local FINDINGS, FINDING = D.findings, {}  -- label to index
local experts = {}
for index, finding in ipairs(FINDINGS) do
	FINDING[finding.label] = index
	finding.rank = RANK[finding.severity]
	finding.badge = (MARK[finding.severity] or "") .. finding.short
	finding.expert = ProtoExpert.new(
		"edoras.finding." .. finding.label, finding.meaning, expert.group.PROTOCOL, SEVERITY[finding.severity]
	)
	table.insert(experts, finding.expert)
end
local EXPERT = {
	gap = ProtoExpert.new(
		"edoras.analysis.gap", "The sequence count skips packets: lost before this capture, or not sent here",
		expert.group.SEQUENCE, expert.severity.WARN
	),
	duplicate = ProtoExpert.new(
		"edoras.analysis.duplicate", "The sequence count and the bytes of an earlier packet",
		expert.group.SEQUENCE, expert.severity.WARN
	),
	reordered = ProtoExpert.new(
		"edoras.analysis.reordered", "The packet came late: packets with higher sequence counts came before it",
		expert.group.SEQUENCE, expert.severity.NOTE
	),
}
for _, made in pairs(EXPERT) do table.insert(experts, made) end

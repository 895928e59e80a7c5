-- What Wireshark shows: the protocols, a field for every slot of every layout, and the expert information.

local P = {
	edoras = EDORAS,
	ccsds_sp = Proto("ccsds_sp", "CCSDS Space Packet"),
	cfe = Proto("cfe", "core Flight System"),
	sbn = Proto("sbn", "Software Bus Network"),
	ros2cdr = Proto("ros2cdr", "ROS 2 message (CDR)"),
}
local members = {edoras = {}, ccsds_sp = {}, cfe = {}, sbn = {}, ros2cdr = {}}
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

for _, layout in pairs(D.layouts) do
	for _, slot in ipairs(layout.fields) do
		if slot.kind == "string" or slot.kind == "bytes" then
			slot.record = new_field(layout.protocol, slot.abbreviation, slot.kind, slot.name, nil, slot.doc)
		else
			slot.record = new_field(
				layout.protocol, slot.abbreviation, slot.kind, slot.name, slot.hex and base.HEX or base.DEC,
				slot.names, slot.mask, slot.doc
			)
		end
	end
end

local F = {
	buffer_length = new_field("edoras", "edoras.buffer_length", "uint64", "buffer_length", base.DEC),
	buffer_capacity = new_field("edoras", "edoras.buffer_capacity", "uint64", "buffer_capacity", base.DEC),
	link = new_field("edoras", "edoras.link", "string", "Link"),
	msg_id = new_field("edoras", "edoras.msg_id", "uint16", "MsgId", base.HEX),
	name = new_field("edoras", "edoras.name", "string", "Name"),
	topic = new_field("edoras", "edoras.topic", "string", "Topic"),
	type = new_field("edoras", "edoras.type", "string", "Type"),
	command = new_field("edoras", "edoras.command", "string", "Command"),
	mission_time = new_field("edoras", "edoras.mission_time", "double", "Mission time, s since its epoch"),
	finding = new_field("edoras", "edoras.finding", "string", "Finding"),
	stop = new_field("edoras", "edoras.stop", "string", "Decoded no further"),
	padding = new_field("edoras", "edoras.padding", "bytes", "Padding"),
	gap = new_field("edoras", "edoras.gap", "uint16", "Packets missing before this one", base.DEC),
	duplicate = new_field("edoras", "edoras.duplicate", "bool", "Same sequence count as the packet before"),
	reordered = new_field("edoras", "edoras.reordered", "bool", "Sequence count steps back"),
	body = new_field("ros2cdr", "ros2cdr.body", "bytes", "Body"),
}

local SEVERITY = {note = expert.severity.NOTE, warning = expert.severity.WARN, error = expert.severity.ERROR}
local RANK = {note = 1, warning = 2, error = 3}
local MARK = {warning = "! ", error = "\226\156\151 "}
local FINDING = {}  -- label to index
local experts = {}
for index, finding in ipairs(D.findings) do
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
		"edoras.analysis.duplicate", "The sequence count of the packet before: sent twice",
		expert.group.SEQUENCE, expert.severity.WARN
	),
	reordered = ProtoExpert.new(
		"edoras.analysis.reordered", "The sequence count steps back: reordered, or its sender began anew",
		expert.group.SEQUENCE, expert.severity.NOTE
	),
}
for _, made in pairs(EXPERT) do table.insert(experts, made) end

-- Without a tree for people, only what a filter or a tap refers to is added. What it refers to changes only
-- between passes over the packets, and every pass begins before where the last one ended.
local asked = {any = false, messages = false, protocols = {}, last = math.huge}

local function look_who_asks(tree, number)
	if number <= asked.last then
		asked.any, asked.messages = false, false
		for name in pairs(P) do
			asked.protocols[name] = tree:referenced(Dissector.get(name))
			asked.any = asked.any or asked.protocols[name]
		end
		for _, record in ipairs(members) do
			record.on = tree:referenced(record.field)
			asked.any = asked.any or record.on
			asked.messages = asked.messages or (record.on and record.protocol == "ros2cdr")
		end
		for _, layout in pairs(D.layouts) do
			layout.on = asked.protocols[layout.protocol]
			for _, slot in ipairs(layout.fields) do layout.on = layout.on or slot.record.on end
		end
	end
	asked.last = number
	return asked.any
end

-- Add a header that starts at an offset; return its tree.
local function show_layout(tree, layout, tvb, at, visible)
	if not (visible or layout.on) then return tree end
	local node = tree:add(P[layout.protocol], tvb(at, layout.size), layout.title)
	local little = layout.little
	for _, slot in ipairs(layout.fields) do
		local record = slot.record
		if visible or record.on then
			local range = tvb(at + slot.start, slot.size)
			if slot.kind == "string" then
				node:add(record.field, range, utf8_text(D.text(range:raw(), 1, slot.size)))
			elseif little then
				node:add_le(record.field, range)
			else
				node:add(record.field, range)
			end
		end
	end
	return node
end

-- Add a value that was not read from bytes.
local function show_value(node, record, value, visible)
	if value ~= nil and (visible or record.on) then
		return node:add(record.field, value):set_generated()
	end
	return node
end

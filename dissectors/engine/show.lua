-- Adding to the tree, which is what costs most: as few calls and ranges as can be.

-- Without a tree for people, only what a filter or a tap refers to is added. What tshark refers to changes only
-- between passes over the packets, and every pass begins before where the last one ended. Wireshark draws single
-- packets amid a pass: it is asked about every packet, and given all fields of one that anything refers to.
local asked = {any = false, protocols = {}, last = math.huge}
local interactive = gui_enabled()

local function look_for_protocols(tree)
	local any = false
	for name in pairs(P) do
		local refers = tree:referenced(Dissector.get(name))
		asked.protocols[name] = refers
		any = any or refers
	end
	return any
end

local function look_for_fields(tree)
	for _, record in ipairs(members) do record.on = tree:referenced(record.field) end
	for _, layout in pairs(D.layouts) do
		local slots = {}
		for _, slot in ipairs(layout.fields) do
			if slot.record.on then slots[#slots + 1] = slot end
		end
		layout.add_asked = adder(layout, slots)
		layout.on = asked.protocols[layout.protocol]
	end
	for _, kind in pairs(D.types) do
		kind.on = kind.record.on
		for _, record in ipairs(kind.records) do kind.on = kind.on or record.on end
	end
end

-- Tell what of a packet shall be added: "all", "some" or nil.
local function look_who_asks(tree, number)
	if tree.visible then return "all" end
	if interactive then return look_for_protocols(tree) and "all" or nil end
	if number <= asked.last then
		asked.any = look_for_protocols(tree)
		if asked.any then look_for_fields(tree) end
	end
	asked.last = number
	return asked.any and "some" or nil
end

-- There are no columns where nobody sees them, as in tshark's trees and fields. As above, tshark does not change
-- its mind amid a pass; passes for trees and for lists are told apart.
local passes = {[true] = {last = math.huge}, [false] = {last = math.huge}}  -- by whether the tree is for people

local function has_columns(pinfo, visible, number)
	local pass = passes[visible]
	if number <= pass.last then pass.columns = interactive or tostring(pinfo.cols.info) ~= "(info)" end
	pass.last = number
	return pass.columns
end

-- Add a header that starts at an offset and that somebody asks for; return its tree.
local function show_layout(tree, layout, tvb, at, visible)
	local bytes = cut(tvb, at, layout.size)
	local node = layout.title and add(tree, layout.proto, bytes, layout.title) or add(tree, layout.proto, bytes)
	local add_slots = visible and layout.add_all or layout.add_asked
	add_slots(node, tvb, at, W.s)
	return node
end

-- Add a value that was not read from bytes; return it, or its parent where nobody asks for it.
local function show_value(node, record, value, visible)
	if not (visible or record.on) then return node end
	local item = add(node, record.field, value)
	if visible then set_generated(item) end
	return item
end

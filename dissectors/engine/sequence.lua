-- Sequence counts, followed by the rules of edoras_tools.sessions.sequence, which say what is meant here.
-- What a later packet shows to be no gap, or not late, is taken back: the second pass over a file knows more.

local MODULUS = D.limits.sequence_modulus
local FORWARD = MODULUS / 2
local WINDOW, REPEATED, BOOT_APART = 1024, 128, 3  -- counts, seconds
local FIRST_COUNTS, REMEMBERED, GOES_ON, LEAST_HOLE, MOST_STRANDS = 64, FORWARD / 2, 3, 16, 8

local function position_of(strand, count)
	return strand.last + (count - strand.last + FORWARD) % MODULUS - FORWARD
end

local function hole_at(strand, position)
	for index = #strand.holes, 1, -1 do
		local hole = strand.holes[index]
		if hole.first <= position then
			if position < hole.stop then return hole, index end
			return nil
		end
	end
	return nil
end

local function unknown(position)  -- what may come late before a strand's first packet: nobody missed it
	return {first = position - WINDOW, stop = position}
end

local function new_strand(position, packet, holes)
	return {
		last = position, boot = packet.boot, bodies = {[position % REPEATED] = packet.body}, holes = holes, place = packet.place,
		front = 0, behind = 0, late = {},
	}
end

-- Put a strand first; forget those that did not move for long.
local function add_strand(stream, strand)
	local strands = {strand}
	for _, other in ipairs(stream.strands) do
		if #strands < MOST_STRANDS and strand.place - other.place <= REMEMBERED then
			strands[#strands + 1] = other
		end
	end
	stream.strands = strands
end

local function went_on(stream, strand, packet)
	strand.place, strand.moved, stream.moved = packet.place, true, true
	local strands = stream.strands
	if strands[1] == strand then return end
	for index = 2, #strands do
		if strands[index] == strand then table.remove(strands, index) end
	end
	table.insert(strands, 1, strand)
end

local function advance(stream, strand, packet)
	strand.last = strand.last + 1
	strand.bodies[strand.last % REPEATED] = packet.body
	strand.boot = packet.boot or strand.boot
	strand.front = strand.front + 1
	local holes = strand.holes
	while holes[1] do
		local kept = holes[1].stop - holes[1].first > WINDOW and REMEMBERED or WINDOW
		if holes[1].stop > strand.last - kept then break end
		table.remove(holes, 1)
	end
	went_on(stream, strand, packet)
end

local function begin_strand(stream, strand)
	if #stream.strands > 0 then stream.moved = true end
	add_strand(stream, strand)
end

-- Take counts of a hole for not missing after all.
local function find(hole, count)
	if hole.gap then
		local left = hole.gap.missing - count
		hole.gap.missing = left
		analysis[hole.gap.frame] = left > 0 and left or nil
	end
end

-- Make the packets in front of a hole another sender's.
local function divide(stream, strand, hole, index, position, packet)
	local taken_back = math.max(#strand.late - 1, 0)
	for place = 1, taken_back do analysis[strand.late[place]] = nil end
	strand.late = {}
	local other = new_strand(position, packet, {})
	other.moved = true
	if not hole.gap then
		other.holes[1] = unknown(position - taken_back)
		begin_strand(stream, other)
		return
	end
	find(hole, hole.stop - position)
	local above = {unknown(hole.stop)}
	for place, item in ipairs(strand.holes) do
		if place < index then other.holes[place] = item end
		if place > index then above[#above + 1] = item end
	end
	if position > hole.first then
		other.holes[index] = {first = hole.first, stop = position, gap = hole.gap}
	end
	strand.holes = above
	add_strand(stream, other)
	went_on(stream, other, packet)
end

local function fill(strand, hole, index, position)
	if position == hole.first then
		hole.first = position + 1
	else
		if position + 1 < hole.stop then
			table.insert(strand.holes, index + 1, {first = position + 1, stop = hole.stop, gap = hole.gap})
		end
		hole.stop = position
	end
	if hole.first == hole.stop then table.remove(strand.holes, index) end
end

local function comes_late(stream, strands, packet, missed)
	for _, strand in ipairs(strands) do
		local position = position_of(strand, packet.count)
		local hole, index = hole_at(strand, position)
		if hole and (hole.gap ~= nil) == missed then
			if position > strand.last - WINDOW then
				if position ~= hole.first and missed then
					strand.late = {}
				elseif #strand.late == 0 or position ~= strand.behind then
					strand.late, strand.front = {packet.frame}, 0
				else
					strand.late[#strand.late + 1] = packet.frame
				end
				strand.behind = position + 1
				if #strand.late >= GOES_ON and (not missed or strand.front >= GOES_ON - 1)
					and hole.stop - position > LEAST_HOLE then
					divide(stream, strand, hole, index, position, packet)
					return true
				end
				if position > strand.last - REPEATED then strand.bodies[position % REPEATED] = packet.body end
				find(hole, 1)
				fill(strand, hole, index, position)
				analysis[packet.frame], stream.moved = "reordered", true
				return true
			elseif hole.stop - hole.first > WINDOW then
				strand.late = {}
				divide(stream, strand, hole, index, position, packet)
				return true
			end
		end
	end
	return false
end

-- It is one only where the count moves; its bytes are those of an earlier one in any case.
local function comes_twice(stream, packet)
	stream.again = true
	if stream.moved then analysis[packet.frame] = "duplicate" end
end

local function comes_again(stream, strands, packet)
	for _, strand in ipairs(strands) do
		local position = position_of(strand, packet.count)
		if position <= strand.last and position > strand.last - REPEATED and not hole_at(strand, position) then
			if strand.bodies[position % REPEATED] == packet.body then
				comes_twice(stream, packet)
				return true
			elseif not strand.moved and position == strand.last then
				strand.bodies[position % REPEATED] = packet.body
				return true
			end
		end
	end
	return false
end

local function is_ahead(stream, strands, packet, reach)
	local nearest, least = nil, reach + 1
	for _, strand in ipairs(strands) do
		local step = position_of(strand, packet.count) - strand.last
		if step > 0 and step < least then nearest, least = strand, step end
	end
	if not nearest or (least > WINDOW and packet.count < FIRST_COUNTS and not (packet.boot and nearest.boot)) then
		return false
	end
	local gap = {frame = packet.frame, missing = least - 1}
	analysis[packet.frame] = gap.missing
	table.insert(nearest.holes, {first = nearest.last + 1, stop = nearest.last + least, gap = gap})
	nearest.last = nearest.last + least - 1
	advance(stream, nearest, packet)
	nearest.late = {}
	return true
end

-- Take a packet of a stream: its count, frame number and bytes, and its boot, where it has a time.
local function follow_count(stream, packet)
	local count, boot = packet.count, packet.boot
	stream.place = stream.place + 1
	packet.place = stream.place
	local again = stream.count == count and stream.body == packet.body
	stream.count, stream.body, stream.again = count, packet.body, false
	if again then return comes_twice(stream, packet) end
	local strands = {}
	for _, strand in ipairs(stream.strands) do
		if not boot or not strand.boot or math.abs(boot - strand.boot) <= BOOT_APART then
			strands[#strands + 1] = strand
		end
	end
	for _, strand in ipairs(#strands > 0 and strands or stream.strands) do
		if (strand.last + 1) % MODULUS == count then
			advance(stream, strand, packet)
			return
		end
	end
	if not (comes_late(stream, strands, packet, true) or comes_again(stream, strands, packet)
		or is_ahead(stream, strands, packet, WINDOW) or comes_late(stream, strands, packet, false)
		or is_ahead(stream, strands, packet, FORWARD)) then
		begin_strand(stream, new_strand(count, packet, {unknown(count)}))
	end
end

return {follow = follow_count}
